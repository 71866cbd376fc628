"""The sequencer: decides what is measured when."""
