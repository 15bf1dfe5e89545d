"""What every room builds on: types, checks, fields of modules, arrays, text and files."""
