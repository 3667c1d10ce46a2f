"""The triangulation of Yusov & Turlapov 2010: fine where its zero trees say so."""
