"""What several groups share: options, tables, pictures, plots, and pairs of real pictures."""
