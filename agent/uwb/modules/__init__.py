"""What UWB modules say on their ports, a parser per protocol: bytes in, ranges out. Sans-I/O."""
