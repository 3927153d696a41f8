"""From rows to results: conditions, statistics, tables, figures, one page."""
