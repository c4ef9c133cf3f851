"""What people configure: the fleet file, shared by all hosts, and the node file of one host.

Both files and all keys but an RC's name and driver are optional. What is wrong in them ends in one `BadInput` line that
names file, key and remedy. Durations are whole ns (`Ns`), but seconds as float where Zenoh is given them
(`MeshConfig`)."""
