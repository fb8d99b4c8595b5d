"""What a clip's tracks tell before they are solved, and how several clips, or windows of one, are solved at once."""
