"""The packets of the scan board: bytes to frozen values and back, without I/O."""
