"""The simplest model that explains a scan."""
