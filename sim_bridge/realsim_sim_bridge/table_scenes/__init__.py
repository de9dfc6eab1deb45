"""Generated table scenes: objects of a pool dropped on table models until they rest."""
