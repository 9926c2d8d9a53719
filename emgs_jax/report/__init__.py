"""Pages and tables of runs: report.html, results of many runs beside published numbers, and the gate."""
