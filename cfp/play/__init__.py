"""A page in the browser to play with a robot: the simulation live, with policies, by hand, and with other matter."""
