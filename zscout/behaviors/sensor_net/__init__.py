"""Place Sensor Net: robots hide in the dark, turn to the light and watch for motion (the paper, section 3).

`place_robot` handles one robot, `place_sensor_net` many; `net` decides, without a mesh, which of them are active."""
