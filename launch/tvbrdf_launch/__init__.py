"""Launch files, the launcher and the command line."""
