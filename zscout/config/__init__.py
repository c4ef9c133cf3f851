"""What people configure: the fleet file, shared by all hosts, and the node file of one host.

Both files and all keys but an RC's name and driver are optional. An error is one `BadInput` line that names file, key
and remedy. Durations are whole ns (`Ns`), except in `MeshConfig`: Zenoh takes seconds as float."""
