"""Pictures for people: frames, films, recordings, replays, and the window on the screen."""
