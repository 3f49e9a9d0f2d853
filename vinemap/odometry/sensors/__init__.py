"""What else knows how a robot moves: wheels and gyroscopes between frames, satellite fixes now and then."""
