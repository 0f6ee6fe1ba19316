"""The host's end: from bytes on a port to counts, ohms and kilopascal."""
