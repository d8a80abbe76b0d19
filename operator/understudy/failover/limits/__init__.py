"""What may hold a recovery back. Only pure rules; the monitor and the command line ask here."""
