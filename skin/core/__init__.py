"""What every room needs: settings and their errors, files, messages, random numbers."""
