"""Speed and load of the commands and the service, measured from outside."""
