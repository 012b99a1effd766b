# raster_build_hash: SHA-256 over everything that can change a result: the text of the sources and of this build's
# recipe, the compiler and the flags. Paths, folders and time stay out. It enters the renderer's build digest.
file(GLOB hashed_files RELATIVE ${CMAKE_CURRENT_SOURCE_DIR}
     ${CMAKE_CURRENT_SOURCE_DIR}/raster/*.cpp ${CMAKE_CURRENT_SOURCE_DIR}/raster/*.hpp
     ${CMAKE_CURRENT_SOURCE_DIR}/raster/*.in)
list(APPEND hashed_files CMakeLists.txt cmake/build_hash.cmake)
list(SORT hashed_files)
set(hashed_text "")
foreach(name IN LISTS hashed_files)
  file(SHA256 ${CMAKE_CURRENT_SOURCE_DIR}/${name} digest)
  string(APPEND hashed_text "${name} ${digest}\n")
  set_property(DIRECTORY APPEND PROPERTY CMAKE_CONFIGURE_DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/${name})
endforeach()
string(TOUPPER "${CMAKE_BUILD_TYPE}" build_type_upper)
string(APPEND hashed_text
  "compiler ${CMAKE_CXX_COMPILER_ID} ${CMAKE_CXX_COMPILER_VERSION}\n"
  "build type ${CMAKE_BUILD_TYPE}\n"
  "flags ${CMAKE_CXX_FLAGS} ${CMAKE_CXX_FLAGS_${build_type_upper}} ${raster_flags}\n"
  "processor ${CMAKE_SYSTEM_PROCESSOR}\n")
string(SHA256 raster_build_hash "${hashed_text}")
configure_file(${CMAKE_CURRENT_SOURCE_DIR}/raster/build_constants.hpp.in
               ${CMAKE_CURRENT_BINARY_DIR}/generated/build_constants.hpp @ONLY)
