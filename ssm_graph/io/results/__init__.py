"""Result folders, whole or growing."""
