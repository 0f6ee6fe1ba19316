"""What every room shares: arrays, checks, configuration, files, tables, text, plots, progress, processes."""
