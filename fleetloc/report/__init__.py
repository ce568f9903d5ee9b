"""Reports of runs: figures, tables, plots, pages."""
