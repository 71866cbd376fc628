"""The fitter: fits each scan as it arrives."""
