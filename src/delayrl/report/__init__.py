"""Reports: rows become conditions, results, tables, statistics, figures and one page."""
