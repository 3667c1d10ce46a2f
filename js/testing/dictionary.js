/** The dictionary of metadata (FORMAT.md §4.6). */

export const DICTIONARY = new TextEncoder().encode(
  [
    "GEOGCRS[\\\"NAD27\\\",BOUNDCRS[SOURCECRS[DATUM[\\\"North American Datum 1983\\\",ELLIPSOID[\\\"GRS 1980\\\",6378137,298.257222101,LENGTHUNIT[\\\"metre\\\",1]]],BASEGEOGCRS[\\\"un",
    "known\\\",PROJCRS[\\\"unnamed\\\",BASEGEOGCRS[\\\"WGS 84\\\",DATUM[\\\"World Geodetic System 1984\\\",ELLIPSOID[\\\"WGS 84\\\",6378137,298.257223563,LENGTHUNIT[\\\"metre\\\",1]]],PRI",
    "MEM[\\\"Greenwich\\\",0,ANGLEUNIT[\\\"degree\\\",0.0174532925199433]],ID[\\\"EPSG\\\",4326]],CONVERSION[\\\"unnamed\\\",METHOD[\\\"Polar Stereographic (variant B)\\\",METHOD[\\\"Lamb",
    "ert Conic Conformal (2SP)\\\",ID[\\\"EPSG\\\",9802]],METHOD[\\\"Transverse Mercator\\\",ID[\\\"EPSG\\\",9807]],PARAMETER[\\\"Latitude of natural origin\\\",0,ANGLEUNIT[\\\"degree\\\"",
    ",0.0174532925199433],ID[\\\"EPSG\\\",8801]],PARAMETER[\\\"Longitude of natural origin\\\",0,ANGLEUNIT[\\\"degree\\\",0.0174532925199433],ID[\\\"EPSG\\\",8802]],PARAMETER[\\\"Scal",
    "e factor at natural origin\\\",0.9996,SCALEUNIT[\\\"unity\\\",1],ID[\\\"EPSG\\\",8805]],METHOD[\\\"Albers Equal Area\\\",ID[\\\"EPSG\\\",9822]],PARAMETER[\\\"Latitude of false orig",
    "in\\\",0,ANGLEUNIT[\\\"degree\\\",0.0174532925199433],ID[\\\"EPSG\\\",8821]],PARAMETER[\\\"Longitude of false origin\\\",0,ANGLEUNIT[\\\"degree\\\",0.0174532925199433],ID[\\\"EPSG\\",
    "\",8822]],PARAMETER[\\\"Latitude of 1st standard parallel\\\",0,ANGLEUNIT[\\\"degree\\\",0.0174532925199433],ID[\\\"EPSG\\\",8823]],PARAMETER[\\\"Latitude of 2nd standard para",
    "llel\\\",0,ANGLEUNIT[\\\"degree\\\",0.0174532925199433],ID[\\\"EPSG\\\",8824]],PARAMETER[\\\"Easting at false origin\\\",0,LENGTHUNIT[\\\"metre\\\",1],ID[\\\"EPSG\\\",8826]],PARAMETE",
    "R[\\\"Northing at false origin\\\",0,LENGTHUNIT[\\\"metre\\\",1],ID[\\\"EPSG\\\",8827]]],PARAMETER[\\\"False easting\\\",0,LENGTHUNIT[\\\"metre\\\",1],ID[\\\"EPSG\\\",8806]],PARAMETER[",
    "\\\"False northing\\\",0,LENGTHUNIT[\\\"metre\\\",1],ID[\\\"EPSG\\\",8807]]],CS[ellipsoidal,2],AXIS[\\\"latitude\\\",north,ORDER[1],AXIS[\\\"longitude\\\",east,ORDER[2],CS[Cartesia",
    "n,2],AXIS[\\\"easting\\\",east,ORDER[1],LENGTHUNIT[\\\"metre\\\",1]],AXIS[\\\"northing\\\",north,ORDER[2],LENGTHUNIT[\\\"metre\\\",1]]]PROJCS[\\\"unnamed\\\",GEOGCS[\\\"NAD83\\\",DATUM",
    "[\\\"North_American_Datum_1983\\\",SPHEROID[\\\"GRS 1980\\\",6378137,298.257222101,AUTHORITY[\\\"EPSG\\\",\\\"7019\\\"]],AUTHORITY[\\\"EPSG\\\",\\\"6269\\\"]],PRIMEM[\\\"Greenwich\\\",0],A",
    "UTHORITY[\\\"EPSG\\\",\\\"4269\\\"]],GEOGCS[\\\"WGS 84\\\",DATUM[\\\"WGS_1984\\\",SPHEROID[\\\"WGS 84\\\",6378137,298.257223563,AUTHORITY[\\\"EPSG\\\",\\\"7030\\\"]],AUTHORITY[\\\"EPSG\\\",\\\"6",
    "326\\\"]],PRIMEM[\\\"Greenwich\\\",0,AUTHORITY[\\\"EPSG\\\",\\\"8901\\\"]],UNIT[\\\"degree\\\",0.0174532925199433,AUTHORITY[\\\"EPSG\\\",\\\"9122\\\"]],AUTHORITY[\\\"EPSG\\\",\\\"4326\\\"]],PROJ",
    "ECTION[\\\"Lambert_Conformal_Conic_2SP\\\"],PROJECTION[\\\"Transverse_Mercator\\\"],PARAMETER[\\\"latitude_of_origin\\\",0],PARAMETER[\\\"central_meridian\\\",0],PARAMETER[\\\"sc",
    "ale_factor\\\",0.9996],PROJECTION[\\\"Albers_Conic_Equal_Area\\\"],PARAMETER[\\\"latitude_of_center\\\",0],PARAMETER[\\\"longitude_of_center\\\",0],PARAMETER[\\\"standard_paral",
    "lel_1\\\",0],PARAMETER[\\\"standard_parallel_2\\\",0],PARAMETER[\\\"false_easting\\\",0],PARAMETER[\\\"false_northing\\\",0],UNIT[\\\"metre\\\",1,AUTHORITY[\\\"EPSG\\\",\\\"9001\\\"]],AX",
    "IS[\\\"Easting\\\",EAST],AXIS[\\\"Northing\\\",NORTH]]\"}\"description\":\",\"offset\":0.0,\"scale\":1.0,\"units\":\"metre\",\"mask_kind\":\"none\",\"software\":\"terrainwave \"mask_kind\":",
    "\"mask\",\"nodata\":32767,\"mask_kind\":\"nan\",\"nodata\":\"nan\",{\"area_or_point\":\"Point\",\"crs\":\"EPSG:4326\",\"area_or_point\":\"Area\",\"crs\":\"EPSG:326258323269\",\"mask_kind\":\"",
    "nodata\",\"nodata\":-9999.0,\"nodata\":-32768,\"software\":\"terrainwave 0.1.0\",\"transform\":[30.0,0.0,-1.0,0.0,0.0002777777777777778,0.0,0.0,-0.0002777777777777778,0.00",
    "08333333333333334,0.0,-0.0008333333333333334,5000000.0]}",
  ].join(""),
);
