"""The piezoresistive cell: pressure to resistance, and back."""
