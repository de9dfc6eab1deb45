"""BOP: scenes, annotations, models; millimetres there, metres here."""
