"""What is there on POSIX alone."""

MODULES = {"fcntl", "resource", "grp", "pwd", "termios", "tty", "pty", "syslog"}
SIGNALS = "SIGHUP SIGALRM SIGPIPE SIGQUIT SIGUSR1 SIGUSR2".split()
CALLS = "fork forkpty wait3 wait4 sysconf sched_getaffinity pread statvfs getuid geteuid chown".split()
