"""The processes of a rig: one folder a node, with its drivers and its simulated twin."""
