"""The recorder's process: `python -m zscout.services.recorder`."""

from zscout.services.recorder.run import main

main()
