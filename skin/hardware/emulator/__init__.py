"""The emulator: a simulated skin behind a pseudo-terminal or a TCP port, in real time."""
