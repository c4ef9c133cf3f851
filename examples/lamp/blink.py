import time

import zscout

with zscout.connect() as lab, lab.hold("blink", {"lamp/desk": {"level": 200}}) as held:
    for level in (50, 200):
        print(held.command("lamp/desk", {"name": "set", "level": level}))
        time.sleep(2)
