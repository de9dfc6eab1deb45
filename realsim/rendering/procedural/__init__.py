"""Random materials, skies and rooms out of formulas, and the user's own images of them."""
