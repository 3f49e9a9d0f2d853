"""What makers of vinemap run: accuracy, speed and odometry measured into the docs, a search of settings, pictures."""
