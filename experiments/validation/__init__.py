"""The laws of mechanics that the simulators must obey, each held against an answer that is not theirs."""
