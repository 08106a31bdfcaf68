"""What a skin can know, and where its sensors belong."""
