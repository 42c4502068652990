"""`acsard tls`: a certificate authority of the user's own, and the certificates that it issues."""
