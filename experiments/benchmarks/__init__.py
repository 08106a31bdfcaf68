"""What ``make bench`` measures: the speed of the simulation, of the training and of the live view."""
