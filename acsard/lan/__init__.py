"""Shell: `acsard lan`: an authority of your own, and the certificates it gives."""
