"""Holds a robot and a share of a radio, and sends the robot a command: `python hold_blocking.py`."""

import zscout

NEEDS = {"robot/scout33": {}, "radio/rf0": {"command_rate": 5}}

with zscout.connect() as lab, lab.hold("survey", NEEDS, min_runtime=60) as held:
    print("holding", *held.rcs)
    print(held.command("robot/scout33", {"name": "echo", "value": "hello"}))
