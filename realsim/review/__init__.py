"""The browser in which a person accepts or rejects what was registered."""
