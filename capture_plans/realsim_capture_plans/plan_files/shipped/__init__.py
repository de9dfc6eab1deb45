"""Plans that come with realsim, as plan files."""
