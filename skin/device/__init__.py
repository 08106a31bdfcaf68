"""Sources of touches, simulated and recorded: imperfections, resampling, units, files."""
