"""ohmskin: readout, emulation, driver and verification of resistive robot skins."""

__version__ = "0.2.0"
