"""Reference motions: clips, their files, the leap and how it was planned."""
