"""Reading what people bring: robot poses in any format and folders of images.

What the numbers mean is said by the user, stated by the file, or proven by the images; it is never
guessed. `RawPoses.possible` lists every reading that a file leaves open.
"""
