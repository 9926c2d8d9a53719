"""Pages and tables of runs: report.html, results of many runs, numbers that papers print beside them, the gate."""
