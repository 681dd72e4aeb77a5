"""How data sets lie on disk: one file each, which finds the scenes below a folder."""
