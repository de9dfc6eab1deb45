"""`realsim robots`: the arms and hands that are found, and what can be proven of one."""
