"""Programs of robots in their makers' languages: URScript, KRL, RAPID, Fanuc LS, INFORM."""
