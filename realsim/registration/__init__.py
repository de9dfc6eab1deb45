"""The 6-DoF pose of every known object from the depth of many views, and how sure it is."""
