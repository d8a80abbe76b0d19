"""What every notation shares: positions in a text, problems, values and expressions. It knows no leaf."""
