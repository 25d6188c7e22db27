"""What a run looked like: recording it, summing it up, and showing it to people."""
