"""Numbers from the literature that come with jaxrod, as plain files. See README.md."""
