"""What happens to a stream between the port and a person: window, verdict, terminal, page. No options."""
