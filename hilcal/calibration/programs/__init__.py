"""Programs of robots in their makers' languages: KRL, RAPID, Fanuc LS, INFORM."""
