"""Friction of a real cloth from a film of a phone: a tray is tilted until the cloth slides."""
