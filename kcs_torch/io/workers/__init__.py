"""Libraries in C that crash or loop on damaged files: scripts that read with them in a process of their own."""
