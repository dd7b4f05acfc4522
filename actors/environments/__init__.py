"""The room of Gymnasium: a user's environment is made, stepped, read and blamed here."""
