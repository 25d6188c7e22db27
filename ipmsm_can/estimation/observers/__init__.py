"""Position observers, one file each, on the regression of Lemma 1."""
