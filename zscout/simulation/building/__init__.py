"""The simulated building: plan, light, robots, camera pictures and their transmission, pure under virtual time.

Metres, seconds, radians; x to the right, y up; heading 0 along +x, counter-clockwise positive. `plan` reads a
building, `world` moves it, `air` is a video receiver.
"""
