"""Options that several subcommands share, and how a command takes a group of them."""
