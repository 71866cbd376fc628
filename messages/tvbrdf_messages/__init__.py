"""What travels between the nodes of a rig: messages, topics, codec, bus and clocks."""
