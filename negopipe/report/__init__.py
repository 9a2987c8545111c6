"""What a person looks at: figures, animations and the page that holds them."""
