"""The whole board in software: from contacts on the skin to bytes on a port."""
