"""Tables and pictures of what was measured: ``report.make_report`` writes them all."""
