"""Annotation: the registered scene and its grasps, back-projected onto every frame of a session.

annotate.py    over all views: what is done already, who does the rest, what is written
frame.py       one view: a pure function from the scene, the camera and the depth to its files
files.py       what lies where in the session's folder
"""
