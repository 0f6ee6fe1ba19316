"""The scanned resistive grid with real parts: ohms to volts to counts."""
