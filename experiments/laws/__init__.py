"""Laws of mechanics: each is a test against an independent solution (``make physics``)."""
