"""The functions' zips and the template that names them."""
