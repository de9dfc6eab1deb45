"""What is wrong with the data, shown without a hand-eye; what is done about it."""
