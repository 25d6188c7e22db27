"""Position observers, one file each, on the regression of Lemma 1 and its records in `common`."""
