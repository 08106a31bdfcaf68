"""The live view: verdicts on the stream of a skin, in the terminal and on a web page."""
