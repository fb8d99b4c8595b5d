"""Tables of text, with a row a frame or a row a frame and joint, whatever their columns are called."""
