"""Arms and depth cameras behind two interfaces, on the makers' own libraries."""
