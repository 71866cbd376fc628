"""The recorder: what a run says, in a bag."""
