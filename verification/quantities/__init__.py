"""The quantities that a requirement may limit, one per module, each with its entry of the catalogue."""
