"""Place Sensor Net: robots hide in the dark, turn to the light and watch for motion.

The paper's most demanding behavior (section 3). `place_robot` takes one robot through it, `place_sensor_net`
many; `net` decides, without a mesh, which robots are at it and who stands in for one that is lost.
"""
