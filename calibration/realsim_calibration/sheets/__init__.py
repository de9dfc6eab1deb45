"""Printable targets: vector sheets at exact scale, and pictures of them."""
