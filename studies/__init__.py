"""Studies of the program itself: how often the diagnosis is right, and what planning buys."""
