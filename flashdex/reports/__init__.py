"""Pictures out: charts, films, the report page and tables for the terminal."""
