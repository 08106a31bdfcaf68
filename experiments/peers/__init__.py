"""What others built, on the same touches: files to them, answers back."""
