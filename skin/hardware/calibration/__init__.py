"""From a bench session to the constants of a simulated device."""
