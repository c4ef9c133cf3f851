"""Execute a command that ends with its parent process; run this file as a program.

    python -I -S launch.py PARENT COMMAND [ARG]...

It asks the kernel for SIGTERM when its parent (PARENT, a pid) dies, then executes COMMAND. It imports nothing of
zscout. Commands that hold devices have a guardian instead (`guardian.py`), which ends their children as well.
"""

import ctypes
import os
import signal
import sys

PR_SET_PDEATHSIG = 1
NOT_EXECUTABLE, NOT_FOUND = 126, 127
LAUNCH = (sys.executable, "-I", "-S", __file__)
"""Command line up to PARENT."""


def main() -> None:
    # The command must not inherit the signal handlers that Python has set.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    parent, command = int(sys.argv[1]), sys.argv[2:]
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != parent:
        sys.exit(128 + signal.SIGTERM)
    try:
        os.execvp(command[0], command)  # noqa: S606 - the purpose of this program
    except OSError as error:
        sys.stderr.write(f"zscout: {command[0]} can't be run: {error.strerror}; check the path\n")
        sys.exit(NOT_FOUND if isinstance(error, FileNotFoundError) else NOT_EXECUTABLE)


if __name__ == "__main__":
    main()
