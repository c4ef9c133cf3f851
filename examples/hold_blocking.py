"""Holds a robot and a share of a radio, and sends the robot a command: `python hold_blocking.py`.

`zscout.Revoked` is raised in the body when the hold is taken away, whatever the body is doing."""

import zscout

NEEDS = {"robot/scout33": {}, "radio/rf0": {"command_rate": 5}}

with zscout.connect() as lab, lab.hold("survey", NEEDS, timeout=600) as held:
    print("holding", *held.rcs)
    print(held.command("robot/scout33", {"name": "echo", "value": "hello"}))
