"""``make fuzz``: damaged clouds, each of which must end in a right product or in one clear line."""
