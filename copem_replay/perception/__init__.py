"""What each unit lists: where it stands, what it can see, which error it makes (PEM)."""
