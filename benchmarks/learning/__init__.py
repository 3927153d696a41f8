"""The base beside other libraries."""
