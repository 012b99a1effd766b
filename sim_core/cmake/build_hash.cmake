# sim_core_build_hash: SHA-256 over everything that can change a result: the text of the sources and of this build's
# recipe, the compiler, the flags and the instruction set. Paths, folders and time stay out. File names are relative and
# in a fixed order. Datasets' content keys use it.
file(GLOB_RECURSE hashed_files CONFIGURE_DEPENDS RELATIVE ${CMAKE_CURRENT_SOURCE_DIR}
     ${CMAKE_CURRENT_SOURCE_DIR}/src/*.cpp ${CMAKE_CURRENT_SOURCE_DIR}/src/*.hpp ${CMAKE_CURRENT_SOURCE_DIR}/src/*.in)
list(APPEND hashed_files CMakeLists.txt cmake/build_hash.cmake)
list(SORT hashed_files)
set(hashed_text "")
foreach(name IN LISTS hashed_files)
  file(SHA256 ${CMAKE_CURRENT_SOURCE_DIR}/${name} digest)
  string(APPEND hashed_text "${name} ${digest}\n")
  # Editing a source must bring a new hash without a manual reconfiguration.
  set_property(DIRECTORY APPEND PROPERTY CMAKE_CONFIGURE_DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/${name})
endforeach()
string(TOUPPER "${CMAKE_BUILD_TYPE}" build_type_upper)
string(APPEND hashed_text
  "compiler ${CMAKE_CXX_COMPILER_ID} ${CMAKE_CXX_COMPILER_VERSION}\n"
  "build type ${CMAKE_BUILD_TYPE}\n"
  "flags ${CMAKE_CXX_FLAGS} ${CMAKE_CXX_FLAGS_${build_type_upper}} ${sim_core_flags}\n"
  "isa ${CMAKE_SYSTEM_PROCESSOR} ${SIM_CORE_ISA}\n"
  "eigen ${Eigen3_VERSION}\n")
string(SHA256 sim_core_build_hash "${hashed_text}")
message(STATUS "sim_core build hash ${sim_core_build_hash}")
configure_file(${CMAKE_CURRENT_SOURCE_DIR}/src/build_constants.hpp.in
               ${CMAKE_CURRENT_BINARY_DIR}/generated/build_constants.hpp @ONLY)
