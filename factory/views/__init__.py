"""What people look at: pictures, films and the report page."""
