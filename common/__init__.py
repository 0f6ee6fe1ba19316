"""What every package shares: arrays, checks, configuration, files, tables, text, plots, progress, processes."""
