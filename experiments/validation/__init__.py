"""The laws of mechanics, each checked against an independent solution."""
