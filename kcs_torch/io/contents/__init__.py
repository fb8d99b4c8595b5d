"""Between what files hold and the library's types: whose joints they are, which frames, and what is made of them."""
