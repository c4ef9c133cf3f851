"""The simulated building: a plan, its light, its robots, what their cameras see and what the air makes of it.

Pure and under virtual time; metres, seconds, radians; x to the right, y up; heading 0 along +x,
counter-clockwise positive. `plan` reads a building, `world` is the building alive, `air` a video receiver.
"""
