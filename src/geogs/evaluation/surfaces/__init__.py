"""How far a surface is from the true one, by every protocol in use."""
