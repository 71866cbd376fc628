"""The player: publishes what a bag holds, with the run's clock."""
