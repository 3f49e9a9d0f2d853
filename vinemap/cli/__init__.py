"""The command line, a command a file, or a few that go together."""
