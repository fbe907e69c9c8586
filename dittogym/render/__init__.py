"""Pictures for people: RGB frames and the window on the screen."""
