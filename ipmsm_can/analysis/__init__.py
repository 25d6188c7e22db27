"""What a log, or a stretch of live traffic, holds of one drive, as arrays: the input of identify and diagnose."""
