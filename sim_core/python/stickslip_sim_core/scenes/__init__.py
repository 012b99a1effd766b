"""What is simulated: cloth, what holds it, what it touches, and how these move."""
