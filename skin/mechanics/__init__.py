"""From surface pressure to true sensor readings, and from an object to surface pressure."""
